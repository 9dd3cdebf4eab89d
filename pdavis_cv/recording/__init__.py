"""Reading and writing recordings; nothing else in the library touches files."""
