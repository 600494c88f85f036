"""Pictures of playpens: maps to scale, light on the floor, perspective views."""
