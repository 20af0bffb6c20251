"""Study of restored starts on the simulated lab. Plan and results: docs/studies/robot_lab.md.

    python -m recipes.robot_lab --part a --out outputs/robot_lab
    python -m recipes.robot_lab --stored --out outputs/robot_lab

Parts: a compares estimated with true start errors, b the RSR of restored starts with that of exact replay; c
makes A/A comparisons; d asks how much start error a verdict bears. Every part goes on where it stopped.
`--store` keeps the outcomes with the code, `--stored` makes tables and figure of those.
"""
