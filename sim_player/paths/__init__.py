"""All paths of a scene: what is reached, traced by every effect, followed in time, labelled as truth."""
