"""What acts on the solid: one effect a file. `roles` says what an effect may need from the simulator."""
