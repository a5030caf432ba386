"""Clean-up of solved takes: nothing here is done unless it was asked for, and all of it is told."""
