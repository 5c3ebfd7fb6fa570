"""What operators are shown: snapshots, the terminal, log lines and Cursor on Target."""
