"""Environments and what is known about them."""
