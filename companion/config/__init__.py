"""Configuration files to parameter records, and the parameters that ground stations change."""
