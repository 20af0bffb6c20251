class Pose:
    """curobo's pose, as far as making one."""

    @staticmethod
    def from_list(values):
        if len(values) != 7:
            raise ValueError(f"a pose has 7 values, got {len(values)}")
        return values
