"""A hand of four fingers that turns an object on its palm, simulated by MuJoCo."""
