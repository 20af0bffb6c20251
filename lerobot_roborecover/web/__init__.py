"""The pages that people work in (`annotate`, `teleop`), and what their servers share."""
