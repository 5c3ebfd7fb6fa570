"""A companion and a simulated vehicle joined in memory on a virtual clock."""
