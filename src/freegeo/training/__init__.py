"""How the embedded model is trained: generated rooms in, `freegeo-tiny` out. Nothing else imports this room."""
