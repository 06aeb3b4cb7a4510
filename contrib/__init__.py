"""Parts for special hardware and other systems; each is a plug-in that the floors do not import."""
