"""Adapters to what people already use. Each is a leaf: nothing else imports it, and it needs only its own library."""
