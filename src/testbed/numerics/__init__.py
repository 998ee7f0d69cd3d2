"""Arithmetic that gives every lane the same bits, however the lanes are split."""
