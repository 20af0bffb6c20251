"""The whole chain from one file: what a YAML says, and the stages that it becomes."""
