"""How the networks learn (paper section 4): the cycle of frozen networks, the plateau schedules, the order of frames, the losses."""
