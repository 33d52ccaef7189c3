"""The documents as a site: `python -m website` prepares the pages and builds them."""
