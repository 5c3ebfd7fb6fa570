"""What real radios print: their formats, read without sockets, clocks or files."""
