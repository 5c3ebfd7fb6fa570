"""What operators are shown, as plain values: the web page, the terminal and recordings share it."""
