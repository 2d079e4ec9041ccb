// A replacement of the notebook's model in a page without kernel: the state and change events.
globalThis.s4aValue = (text) => JSON.parse(text, (key, value) => {
  if (!value || typeof value.base64 !== "string") return value;
  const letters = atob(value.base64), bytes = new Uint8Array(letters.length);
  for (let i = 0; i < letters.length; i++) bytes[i] = letters.charCodeAt(i);
  return new DataView(bytes.buffer);
});
globalThis.s4aModels = {};
globalThis.s4aModel = (id) => {
  const state = s4aValue(document.getElementById(id + "-state").textContent), listeners = {};
  const notify = (name) => [...(listeners["change:" + name] || [])].forEach((act) => act());
  return (s4aModels[id] = {
    get: (name) => state[name],
    set: (name, value) => { state[name] = value; notify(name); },
    update: (changes) => { Object.assign(state, changes); Object.keys(changes).forEach(notify); },
    on: (event, act) => { (listeners[event] ||= []).push(act); },
    off: (event, act) => { listeners[event] = (listeners[event] || []).filter((other) => other !== act); },
    save_changes: () => {},
    saved: true,
  });
};
