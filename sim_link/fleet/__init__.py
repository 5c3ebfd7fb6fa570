"""One vehicle or several from a scenario and options: their endpoints, links and files."""
