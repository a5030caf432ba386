"""What runs a network: one module per runtime, each an optional extra."""
