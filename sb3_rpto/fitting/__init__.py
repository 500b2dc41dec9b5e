"""One robust Gauss-Newton fit within bounds, for one-step errors and for multiple shooting."""
