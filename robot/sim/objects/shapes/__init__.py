"""Shape families: SHAPES maps a name to the function that draws one of its instances."""

from robot.sim.objects.shapes.families import SHAPES as SHAPES
