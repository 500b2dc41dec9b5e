"""Other ways to read recordings that a search does not explain."""
