"""What the papers prove, as functions."""
