"""What shows that pdavis_cv is right; run from a clone, not installed."""
