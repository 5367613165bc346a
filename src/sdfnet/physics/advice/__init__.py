"""What the advisor rests on: the numbers of a scene, a trial of it in few coordinates, and what steps would cost."""
