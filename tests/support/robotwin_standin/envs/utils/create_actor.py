from __future__ import annotations

import sapien.core as sapien


class UnStableError(Exception):
    """The scene does not come to rest."""


class Actor:
    """A rigid body of a task."""

    def __init__(self, entity):
        self.actor = entity

    def get_pose(self):
        return self.actor.get_pose()


def create_box(task, pose, half_size, color, name, is_static=False) -> Actor:
    """A box built from components, as RoboTwin builds its own."""
    entity = sapien.Entity()
    entity.set_name(name)
    kind = sapien.physx.PhysxRigidStaticComponent if is_static else sapien.physx.PhysxRigidDynamicComponent
    body = kind()
    material = task.scene.default_physical_material
    body.attach(sapien.physx.PhysxCollisionShapeBox(half_size=half_size, material=material))
    look = sapien.render.RenderBodyComponent()
    look.attach(sapien.render.RenderShapeBox(half_size, sapien.render.RenderMaterial(base_color=[*color, 1])))
    entity.add_component(body)
    entity.add_component(look)
    entity.set_pose(pose)
    task.scene.add_entity(entity)
    return Actor(entity)
