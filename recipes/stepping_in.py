"""Earlier name of `recipes.intervention_timing`, which works for one release."""

from __future__ import annotations

import sys

from recipes.intervention_timing import main

if __name__ == "__main__":
    print("note: recipes.stepping_in is now recipes.intervention_timing", file=sys.stderr)
    main()
