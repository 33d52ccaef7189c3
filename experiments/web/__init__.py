"""Build the page with the wheel in a browser, whose step is the library's code as WebAssembly."""
