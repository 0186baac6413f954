"""People who walk about: where they may go, how they walk, what rays see of them."""
