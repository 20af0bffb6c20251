"""The study: learned policies, their recovery, and what helps, by the project's own commands."""
