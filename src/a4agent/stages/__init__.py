"""The stages of the agent: Dreamer (how), Thinker (what), Spotter (where), Verifier (whether)."""
