"""What runs in the lab's guest."""
