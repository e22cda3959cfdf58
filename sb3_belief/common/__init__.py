"""What all other packages build on: random number generators, processes, exceptions, versions."""
