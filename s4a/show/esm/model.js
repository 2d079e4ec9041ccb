// What a script needs of the notebook's model, without a notebook: the state of a page, and events of changes.
globalThis.s4aValue = (text) => JSON.parse(text, (key, value) => {
  if (!value || typeof value.base64 !== "string") return value;
  const letters = atob(value.base64), bytes = new Uint8Array(letters.length);
  for (let i = 0; i < letters.length; i++) bytes[i] = letters.charCodeAt(i);
  return new DataView(bytes.buffer);
});
globalThis.s4aModels = {};
globalThis.s4aModel = (id) => {
  const state = s4aValue(document.getElementById(id + "-state").textContent), heard = {};
  const tell = (name) => [...(heard["change:" + name] || [])].forEach((act) => act());
  return (s4aModels[id] = {
    get: (name) => state[name],
    set: (name, value) => { state[name] = value; tell(name); },
    update: (changes) => { Object.assign(state, changes); Object.keys(changes).forEach(tell); },
    on: (event, act) => { (heard[event] ||= []).push(act); },
    off: (event, act) => { heard[event] = (heard[event] || []).filter((other) => other !== act); },
    save_changes: () => {},
    saved: true,
  });
};
