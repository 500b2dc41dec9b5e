"""Trainable dynamics: the source world's P_phi."""
