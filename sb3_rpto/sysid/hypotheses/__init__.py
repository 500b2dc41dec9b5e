"""Other ways to read recordings, tried in one list, and hints at what may be wrong where none explains them."""
