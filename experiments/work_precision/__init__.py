"""Work against precision of every engine and its peers, quantity by quantity."""
