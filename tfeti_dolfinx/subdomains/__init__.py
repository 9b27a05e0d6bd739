"""Subdomains as the dual sees them: Blocks."""
