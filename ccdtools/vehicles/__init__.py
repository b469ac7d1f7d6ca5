"""Cars and roads: plants, road profiles, and how a ride is measured. Studies use them, nothing below does."""
