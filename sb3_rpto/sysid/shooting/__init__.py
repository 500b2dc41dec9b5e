"""Multiple shooting: windows of recordings, their initial states, and fits to them."""
