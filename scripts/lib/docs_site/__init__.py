"""The documents as a site: this checkout's own pages, with a reference written from the code."""
