"""How the PushT starter set and its two policies were made."""
