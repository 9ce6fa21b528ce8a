"""The reference of the documents' site: written from the nodes and commands as they are."""
