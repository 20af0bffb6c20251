"""Names that `env.py` files on the Hub import, from before the package was rearranged."""
