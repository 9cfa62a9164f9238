"""Small things that every floor shares: array types, progress, robust statistics, files."""
