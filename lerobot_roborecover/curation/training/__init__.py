"""Training data from trials, donors and forks, with what weights them."""
