"""Props of a scene, one kind a file: whatever is no character."""

from poise.sim.props.box import Box
from poise.sim.props.carrier import Carrier
from poise.sim.props.door import Door
from poise.sim.props.lift import Lift
from poise.sim.props.mesh import Mesh
from poise.sim.props.prop import Prop
from poise.sim.props.rod import Rod
from poise.sim.props.sphere import Ball
from poise.sim.props.trampoline import Trampoline

__all__ = ["Ball", "Box", "Carrier", "Door", "Lift", "Mesh", "Prop", "Rod", "Trampoline"]
