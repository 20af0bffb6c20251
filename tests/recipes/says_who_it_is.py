"""Prints its process id and waits to be ended: what `test_commands` has a recipe run."""

import os
import time

if __name__ == "__main__":
    print(os.getpid(), flush=True)
    time.sleep(300)
