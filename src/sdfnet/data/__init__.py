"""From a scene to the files that training reads: where to ask, what the distance is there, and how it is kept."""
