"""What RPTO is compared with: model-based methods and variants of SAC, each by its name."""
