"""Published problems on which methods are known to break, each a module with its reference."""
