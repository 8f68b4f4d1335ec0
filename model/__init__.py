"""PVDA as the paper writes it (arXiv 2401.01573); torch only."""
