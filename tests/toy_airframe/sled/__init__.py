"""A sled on a rail, pushed by one thruster: the smallest airframe that the project can fly, from outside its packages."""
