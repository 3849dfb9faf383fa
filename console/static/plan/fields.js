// Labelled fields of one object.  A field: {key, label, as (how its text is read), choices}.

export const plain = { read: (text) => text.trim(), write: (value) => value ?? "" };
export const number = {
  read: (text) => (text.trim() === "" ? null : Number.isFinite(+text) ? +text : undefined),
  write: (value) => (value === null || value === undefined ? "" : String(value)),
};
export const whole = { ...number, read: (text) => { const v = number.read(text); return v === null || Number.isInteger(v) ? v : undefined; } };
export const words = {
  read: (text) => text.split(",").map((word) => word.trim()).filter(Boolean),
  write: (value) => (value ?? []).join(", "),
};

/** Fills `container`; `changed(field, value)` follows a change; returns `{show(fields, values)}`. */
export function createFields(container, prefix, complain, changed) {
  let shown = [];

  function build(fields) {
    shown = fields;
    container.replaceChildren(...fields.flatMap((field) => {
      const label = document.createElement("label"), id = `${prefix}-${field.key}`;
      label.htmlFor = id;
      label.textContent = field.label;
      const input = document.createElement(field.choices ? "select" : "input");
      input.id = id;
      if (field.choices) input.replaceChildren(...field.choices.map(([text], i) => new Option(text, String(i))));
      else input.autocomplete = "off";
      if (field.hint) input.placeholder = field.hint;
      input.addEventListener("change", () => take(field, input));
      return [label, input];
    }));
  }

  function take(field, input) {
    const value = field.choices ? field.choices[+input.value][1] : (field.as ?? plain).read(input.value);
    if (value === undefined) {
      complain(`${field.label}: "${input.value}" is not ${field.as === whole ? "a whole number" : "a number"}.`);
      input.value = input.dataset.shown;
    } else changed(field, value);
  }

  return {
    show(fields, values) {
      if (fields !== shown && !(fields.length === 0 && shown.length === 0)) build(fields);
      for (const field of fields) {
        const input = document.getElementById(`${prefix}-${field.key}`), value = values[field.key];
        const text = field.choices
          ? String(Math.max(0, field.choices.findIndex(([, v]) => v === (value ?? field.usual))))
          : (field.as ?? plain).write(value);
        input.value = input.dataset.shown = text;
      }
    },
  };
}
