"""Views for operators: snapshots, the terminal, log lines and Cursor on Target."""
