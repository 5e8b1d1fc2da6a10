"""Checks of the tests themselves."""
