"""The viewer's parts: what the page is told, who may ask, and the page itself."""
