"""Demos: each is a script to copy, and main(argv) for the tests."""
