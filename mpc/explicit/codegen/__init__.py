"""C source for explicit laws."""
