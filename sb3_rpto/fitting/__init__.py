"""Robust Gauss-Newton fits in a box, and what they tell of their parameters."""
