"""Which effects the data need."""
