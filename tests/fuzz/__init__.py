"""Inputs made to break what decodes them."""
