"""Pages in a browser: a live run, a take, a recording."""
