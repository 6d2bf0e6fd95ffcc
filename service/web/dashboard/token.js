// The access token of the page's address, passed on to everything the page asks for.
const token = new URLSearchParams(location.search).get("token");
export const withToken = (path) => (token ? `${path}${path.includes("?") ? "&" : "?"}token=${encodeURIComponent(token)}` : path);
