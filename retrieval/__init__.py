"""Identify objects by touch: from the gel images of a grasp, find the catalogue photo of the object in the hand.

The stages run one way: images, dataset -> towers -> fusion -> train -> search -> report -> cli.
Nothing is imported here, so `import retrieval` costs nothing.
"""
