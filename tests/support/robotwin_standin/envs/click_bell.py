from ._base_task import Base_Task


class click_bell(Base_Task):
    """Needs an object model that the stand-in does not have."""

    def setup_demo(self, **kwargs):
        super()._init_task_env_(**kwargs)

    def load_actors(self):
        with open("assets/objects/050_bell/model_data0.json") as file:
            self.bell = file.read()
        self.model_name = "050_bell"

    def check_success(self):
        return False
