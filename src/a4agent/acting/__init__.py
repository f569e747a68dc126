"""From a mask to an action: where to touch, where to grasp, and how deep it is."""
