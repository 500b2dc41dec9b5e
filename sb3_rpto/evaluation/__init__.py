"""Learning curves, interquartile means with intervals, and the relativity gap."""
