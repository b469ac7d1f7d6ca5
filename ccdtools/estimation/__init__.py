"""What is measured of a plant, and what its state is judged to be from that."""
