"""Emulate Barrett's pucks: motor pucks, the safety puck, and the person at its pendant."""
