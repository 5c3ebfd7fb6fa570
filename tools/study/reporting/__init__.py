"""Report of a study: figures, tables, verdicts and the page that holds them."""
