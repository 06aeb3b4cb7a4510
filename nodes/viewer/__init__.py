"""The viewer's parts: the page's data, its access control, and the page itself."""
