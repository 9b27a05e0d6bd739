"""Contacts as the user describes them, and the conditions that the geometry makes of them."""
