"""The wheel in a browser: the library's own step as WebAssembly, in one page."""
