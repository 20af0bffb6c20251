"""Files that appear whole, append-only records, texts, progress bars: what every part may use."""
