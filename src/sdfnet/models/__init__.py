"""The two networks of the paper (section 4): the Mesh Encoder and the SDF Calculator."""
