class JointState:
    """curobo's joint state, as far as the planner below reads it."""

    def __init__(self, position):
        self.position = position

    @classmethod
    def from_position(cls, position, joint_names=None):
        return cls(position)
