"""The price of a privacy guarantee, and the guarantee that noise as printed gives."""
