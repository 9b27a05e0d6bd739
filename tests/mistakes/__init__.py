"""Mistakes that users make, and the words that the message must have."""
