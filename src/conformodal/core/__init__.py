"""Small things that every layer shares: array types, progress, robust statistics, files."""
