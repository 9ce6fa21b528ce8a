"""Documentation site: the checkout's pages, and a reference generated from the code."""
