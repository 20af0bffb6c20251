"""Trial logs: the row, its checks, the file, recorded actions, merging. Reading one needs no simulator."""
