"""What `env.py` files on the Hub import that earlier versions wrote: `lerobot_roborecover.env.envhub`."""

import sys

from lerobot_roborecover.evaluation import envhub

sys.modules[f"{__name__}.envhub"] = envhub
