"""The LIBERO starter set as a table: what drove, what went wrong, where the recovery point lies."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot_roborecover.platforms.libero.expert import Flaws
from lerobot_roborecover.scenario import DeviationType, Source, Stage

_QUARTER_TURN = 1.57


@dataclass(frozen=True)
class Recipe:
    """One scenario of the starter set."""

    id: str
    """Scenario id."""
    suite: str
    """LIBERO suite."""
    task: int
    """Index in hf-libero's list of the suite's tasks."""
    init: int
    """Stored init state."""
    step: int
    """Recovery point: number of prefix actions, settling included."""
    stage: Stage
    """What must be resumed, as the frames show it."""
    deviation: DeviationType
    """What is wrong, as the frames show it."""
    sees: str
    """What a viewer sees at the recovery point."""
    flaws: Flaws
    """Of the controller."""
    noise_seed: int | None = None
    """Seed of the paper's action perturbation; None for a natural failure."""

    @property
    def source(self) -> Source:
        """Perturbed where noise was added, else natural."""
        return Source.NATURAL if self.noise_seed is None else Source.PERTURBED

    @property
    def driver(self) -> str:
        """Name of the source policy."""
        return "scripted-weak" if self.noise_seed is None else "scripted-open-loop"


_A, _C, _M, _P = Stage.APPROACH, Stage.CONTACT, Stage.MOVE, Stage.PLACE
_TARGET, _POSE = DeviationType.WRONG_TARGET, DeviationType.WRONG_POSE
_ROLLBACK, _SCENE = DeviationType.STAGE_ROLLBACK, DeviationType.SCENE_CHANGE
_SPATIAL, _OBJECT, _GOAL, _TEN = "libero_spatial", "libero_object", "libero_goal", "libero_10"
_OPEN_LOOP = Flaws(open_loop=True)


def _flaws(**kinds: object) -> Flaws:
    """Flaws of a controller that does not look, either."""
    return Flaws(open_loop=True, **kinds)


# fmt: off
_WEAK = (
    # Grasps that miss again and again.
    ("spatial2-missed", _SPATIAL, 2, 11, 118, _A, _POSE,
     "gripper closed on nothing beside the bowl", Flaws(aim_m=(0, 0.045, 0))),
    ("object1-missed", _OBJECT, 1, 12, 152, _A, _POSE,
     "gripper closed on nothing beside the cream cheese", Flaws(aim_m=(0.05, 0, 0))),
    ("ten1-missed", _TEN, 1, 14, 152, _A, _POSE,
     "gripper closed on nothing beside the cream cheese", Flaws(aim_m=(0, -0.05, 0))),
    # Fingers across the wrong side of a box that is too long for them.
    ("object1-turned", _OBJECT, 1, 29, 97, _C, _POSE,
     "fingers press on both ends of the cream cheese, turned by 90 degrees", Flaws(turn_rad=_QUARTER_TURN)),
    ("goal6-turned", _GOAL, 6, 45, 57, _C, _POSE,
     "fingers press on both ends of the cream cheese, turned by 90 degrees", Flaws(turn_rad=_QUARTER_TURN)),
    ("ten1-turned", _TEN, 1, 36, 140, _C, _POSE,
     "fingers press on both ends of the cream cheese, turned by 90 degrees", Flaws(turn_rad=_QUARTER_TURN)),
    # Objects let go on the way.
    ("spatial2-dropped", _SPATIAL, 2, 16, 94, _A, _ROLLBACK,
     "bowl let go short of the plate and leaning on its edge, hand withdrawn", _flaws(drop_after=8)),
    ("spatial0-dropped", _SPATIAL, 0, 17, 101, _A, _ROLLBACK,
     "bowl let go short of the plate and tipped against its edge, hand withdrawn", _flaws(drop_after=6)),
    ("object0-dropped", _OBJECT, 0, 16, 112, _A, _ROLLBACK,
     "soup can let go half way, standing on the floor, hand withdrawn", _flaws(drop_after=14)),
    ("goal1-dropped", _GOAL, 1, 40, 88, _A, _ROLLBACK,
     "bowl let go short of the stove, standing on the table, hand withdrawn", _flaws(drop_after=5)),
    ("ten7-dropped", _TEN, 7, 18, 100, _A, _ROLLBACK,
     "soup can let go half way, standing on the table, hand withdrawn", _flaws(drop_after=8)),
    ("ten0-dropped", _TEN, 0, 20, 110, _A, _ROLLBACK,
     "soup can let go half way, lying among the others, hand withdrawn", _flaws(drop_after=12)),
    ("ten5-dropped", _TEN, 5, 42, 96, _A, _ROLLBACK,
     "book let go short of the caddy and fallen over, hand withdrawn", _flaws(drop_after=4)),
    # The wrong object.
    ("spatial2-wrong-bowl", _SPATIAL, 2, 20, 76, _A, _TARGET,
     "the other bowl in the gripper, on its way to the plate", _flaws(item="akita_black_bowl_2")),
    ("object5-wrong-item", _OBJECT, 5, 20, 90, _A, _TARGET,
     "orange juice in the gripper, on its way to the basket", _flaws(item="orange_juice_1")),
    ("goal1-wrong-item", _GOAL, 1, 34, 70, _A, _TARGET,
     "cream cheese in the gripper, on its way to the stove", _flaws(item="cream_cheese_1")),
    ("goal6-wrong-item", _GOAL, 6, 35, 50, _A, _TARGET,
     "wine bottle in the gripper, on its way to the bowl", _flaws(item="wine_bottle_1")),
    ("ten0-wrong-item", _TEN, 0, 21, 85, _A, _TARGET,
     "ketchup in the gripper, on its way to the basket", _flaws(item="ketchup_1")),
    # The wrong place.
    ("goal1-wrong-place", _GOAL, 1, 22, 86, _P, _TARGET,
     "bowl held over the plate, which is not where it belongs", _flaws(region="plate_1")),
    ("goal4-wrong-place", _GOAL, 4, 23, 84, _P, _TARGET,
     "bowl held over the stove, not the cabinet", _flaws(region="flat_stove_1_cook_region")),
    ("spatial0-wrong-place", _SPATIAL, 0, 24, 90, _P, _TARGET,
     "bowl held over the stove, not the plate", _flaws(region="flat_stove_1_cook_region")),
    # The right place, missed.
    ("spatial2-beside", _SPATIAL, 2, 25, 105, _P, _POSE,
     "bowl held beside the plate, not over it", _flaws(place_m=(0, 0.09))),
    ("spatial8-beside", _SPATIAL, 8, 43, 112, _P, _POSE,
     "bowl held over the plate's far edge", _flaws(place_m=(-0.06, 0))),
    ("object0-beside", _OBJECT, 0, 26, 150, _P, _POSE,
     "soup can held outside the basket, along its wall", _flaws(place_m=(0, 0.1))),
    # Carried too low.
    ("goal4-too-low", _GOAL, 4, 31, 112, _M, _POSE,
     "bowl held too low, jammed against the cabinet's side", _flaws(carry_m=-0.12)),
    ("object7-too-low", _OBJECT, 7, 32, 88, _M, _POSE,
     "milk held too low, in front of the basket's wall", _flaws(carry_m=-0.12)),
    ("ten7-basket-pushed", _TEN, 7, 33, 92, _P, _SCENE,
     "soup can in the gripper has pushed the basket away", _flaws(carry_m=-0.12)),
)

_PERTURBED = (
    ("spatial0-noise-tipped", _SPATIAL, 0, 38, 158, _A, _SCENE,
     "bowl tipped over between plate and cookie box, hand withdrawn", 117),
    ("spatial1-noise-aside", _SPATIAL, 1, 42, 166, _A, _ROLLBACK,
     "bowl let go beside the plate, hand withdrawn", 121),
    ("goal6-noise-pushed", _GOAL, 6, 32, 126, _A, _POSE,
     "empty gripper over the bowl, cream cheese still on the table", 111),
    ("spatial2-noise-leaning", _SPATIAL, 2, 3, 166, _A, _SCENE,
     "bowl wedged aslant between plate and the other bowl", 3),
    ("spatial0-noise-offset", _SPATIAL, 0, 1, 141, _P, _POSE,
     "bowl held aslant over the plate's edge", 1),
    ("spatial8-noise-offset", _SPATIAL, 8, 10, 137, _P, _POSE,
     "bowl held over the plate's edge", 30),
    ("spatial1-noise-empty", _SPATIAL, 1, 9, 122, _A, _POSE,
     "empty gripper over the plate, bowl still beside the ramekin", 29),
    ("object3-noise-dropped", _OBJECT, 3, 6, 160, _A, _ROLLBACK,
     "sauce bottle lies before the basket, empty hand above it", 6),
    ("goal6-noise-empty", _GOAL, 6, 10, 100, _A, _POSE,
     "empty gripper over the bowl, cream cheese pushed aside", 20),
    ("ten0-noise-empty", _TEN, 0, 2, 160, _A, _POSE,
     "empty gripper over the basket, soup can still among the others", 2),
)
# fmt: on

RECIPES: tuple[Recipe, ...] = (
    *(Recipe(*row) for row in _WEAK),
    *(Recipe(*row[:-1], _OPEN_LOOP, row[-1]) for row in _PERTURBED),
)
"""The set, in its order."""
