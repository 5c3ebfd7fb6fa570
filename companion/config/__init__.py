"""Configuration files to parameter records."""
