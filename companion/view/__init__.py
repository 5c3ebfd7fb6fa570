"""What operators are shown: snapshots as plain values, the terminal, log lines and Cursor on Target."""
