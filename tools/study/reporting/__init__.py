"""What a study looks like: figures, tables, verdicts and the page that holds them."""
