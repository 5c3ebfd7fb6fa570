"""What authors of plugins try their own code with. Nothing of it flies, and it needs no pytest."""
