"""Pictures and masks as arrays and files; no models."""
