"""Times and places of others on our own axes: clocks by stamps and exchanges, maps by pairs."""
