"""An invented two-finger hand, as its vendor would add it to dexkit."""
