"""Plans ahead from recorded paths: plr plan."""
