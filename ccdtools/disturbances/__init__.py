"""What acts on a plant: random, generated or recorded disturbances."""
