"""Who may call, offer and use what: access policy and path rules, applied. Imports `registry`."""
