"""Reconstruction methods, one module each; they take arrays, never files."""
