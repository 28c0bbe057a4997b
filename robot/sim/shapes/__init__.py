"""Shape families: SHAPES maps a name to the function that draws one of its instances."""

from robot.sim.shapes.base import Chart as Chart
from robot.sim.shapes.base import Shape as Shape
from robot.sim.shapes.families import SHAPES as SHAPES
