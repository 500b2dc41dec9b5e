"""What a trace found, for readers and for programs."""
