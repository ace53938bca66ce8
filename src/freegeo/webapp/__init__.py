"""The web app: photos in, an adapted reconstruction out, in a browser."""
