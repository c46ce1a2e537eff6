//! The C header of a device's firmware.

use super::port::{DevicePort, PortUse};
use super::{DeviceProxy, DeviceSpec};
use blastema_core::contract::layout::{Fields, LayoutOf, Primitive, Shape};
use blastema_lite::PortKind;
use std::fmt::Write;

/// Names that C has taken, of those that a field may have in Rust.
const KEYWORDS: [&str; 16] = [
    "auto", "case", "char", "default", "double", "float", "goto", "int", "long", "register",
    "short", "signed", "sizeof", "switch", "unsigned", "void",
];

impl DeviceSpec {
    /// The C header of the firmware: sizes for the library in `core/lite/c`, structs, fingerprints.
    /// The firmware is compiled with `-DBL_CONFIG='"gripper.h"'`, and lists `GRIPPER_PORTS` of its
    /// ports in the order in which they were declared here.
    ///
    /// # Errors
    /// The spec is wrong; the text says how.
    ///
    /// ```
    /// use blastema::prelude::*;
    /// use blastema::DeviceSpec;
    ///
    /// #[derive(Clone, Debug, Event)]
    /// #[contract(name = "gripper/close")]
    /// struct Close {
    ///     #[contract(unit = "N")]
    ///     force: f32,
    /// }
    ///
    /// let gripper = DeviceSpec::new("gripper", "serial:///dev/ttyUSB0", 0x6772_6970);
    /// let header = gripper.accepts::<Close>(0).header().expect("it has a header");
    /// assert!(header.contains("    float force; /* N */"));
    /// assert!(header.contains("#define GRIPPER_CLOSE_IN0(data_) {.object = 1, .id = BL_IN + 0"));
    /// ```
    pub fn header(&self) -> Result<String, String> {
        if let Some(problem) = self.problem.as_ref().or(self.medium.as_ref().err()) {
            return Err(problem.clone());
        }
        let (device, ports) = (identifier(&self.name), &self.ports);
        let guard = device.to_uppercase();
        let objects = ports.iter().map(|port| port.port.object()).max().unwrap_or(1);
        let largest = ports.iter().map(|port| port.port.size().max(port.port.reply())).max();
        let data = (largest.unwrap_or(0) + 1).max(objects + 10).max(24);
        let mut text = format!(
            "/* The device `{}`: generated from the contracts of the robot. */\n\
             #ifndef {guard}_H\n#define {guard}_H\n\n#include <stdint.h>\n\n\
             #define BL_MAX_DATA {data}u\n#define BL_OBJECTS {objects}u\n#define BL_PORTS {}u\n\
             #define {guard}_TYPE {:#010x}u\n\n#pragma pack(push, 1)\n",
            self.name,
            ports.len(),
            self.host.device_type
        );
        let mut known = Vec::new();
        for port in ports {
            let mut of_type = |suffix: &str, of: LayoutOf, size: u8| {
                let name = identifier(port.contract) + suffix;
                // C has no struct without members.
                if size > 0 && !known.contains(&name) {
                    let _ = writeln!(text, "{};", declared("typedef ", of, &name, 0));
                    known.push(name);
                }
            };
            of_type("", port.message, port.port.size());
            of_type("_reply", port.reply, port.port.reply());
        }
        text.push_str("#pragma pack(pop)\n\n/* Indices, for bl_publish and bl_call. */\nenum {\n");
        for port in ports {
            let _ = writeln!(text, "    {},", port_name(port));
        }
        text.push_str("    PORT_COUNT\n};\n\n/* Records of bl_ports, in this order. */\n");
        for port in ports {
            let (of, name) = (&port.port, port_name(port));
            let (base, first) = match of.kind() {
                PortKind::In => ("BL_IN", 0x40),
                PortKind::Out => ("BL_OUT", 0x60),
                PortKind::Call => ("BL_CALL", 0x80),
                PortKind::Variable => ("BL_VARIABLE", 0xc0),
            };
            let _ = writeln!(
                text,
                "#define {name}(data_) {{.object = {}, .id = {base} + {}, .data = (data_), \\\n    \
                 .size = {}, .reply = {}, .fingerprint = {:#010x}u}}",
                of.object(),
                of.id() - first,
                of.size(),
                of.reply(),
                of.fingerprint()
            );
        }
        text.push_str("\n#endif\n");
        Ok(text)
    }
}

/// `GRIPPER_CLOSE_IN0`: the contract, the direction and the number.
fn port_name(port: &DevicePort<DeviceProxy>) -> String {
    let (direction, first) = match port.used {
        PortUse::In { .. } => ("IN", 0x40),
        PortUse::Out { .. } => ("OUT", 0x60),
        PortUse::Call => ("CALL", 0x80),
        PortUse::Variable { .. } => ("VARIABLE", 0xc0),
    };
    let object = match port.port.object() {
        1 => String::new(),
        object => format!("{object}_"),
    };
    let contract = identifier(port.contract).to_uppercase();
    format!("{contract}_{object}{direction}{}", port.port.id() - first)
}

fn identifier(name: &str) -> String {
    let plain = |c: char| if c.is_ascii_alphanumeric() { c.to_ascii_lowercase() } else { '_' };
    let name: String = name.chars().map(plain).collect();
    match name.chars().next() {
        Some('0'..='9') | None => format!("_{name}"),
        _ if KEYWORDS.contains(&name.as_str()) => name + "_",
        _ => name,
    }
}

/// The declaration of a member, or a type, of this name; without the semicolon.
fn declared(before: &str, of: LayoutOf, name: &str, depth: usize) -> String {
    let indent = "    ".repeat(depth);
    match &of().shape {
        Shape::Leaf(leaf) => format!("{indent}{before}{}", leaf_declared(*leaf, name)),
        Shape::Array(of, length) => declared(before, *of, &format!("{name}[{length}]"), depth),
        Shape::Optional(of) => {
            let value = declared("", *of, "value", depth + 1);
            format!(
                "{indent}{before}struct {{\n{indent}    uint8_t some;\n{value};\n{indent}}} {name}"
            )
        }
        Shape::Tuple(parts) => {
            let members = parts.iter().enumerate();
            let members: String = members
                .map(|(at, of)| declared("", *of, &format!("_{at}"), depth + 1) + ";\n")
                .collect();
            format!("{indent}{before}struct {{\n{members}{indent}}} {name}")
        }
        Shape::Struct(_, fields) => {
            format!("{indent}{before}struct {{\n{}{indent}}} {name}", members(fields, depth))
        }
        Shape::Enum(_, variants) => {
            let names: Vec<_> = variants.iter().map(|variant| &*variant.name).collect();
            let numbers = names.iter().enumerate().map(|(at, name)| format!("{at} {name}"));
            let listed = format!("/* {} */", numbers.collect::<Vec<_>>().join(", "));
            let is_plain = |fields: &Fields<LayoutOf>| fields.as_slice().is_empty();
            if variants.iter().all(|variant| is_plain(&variant.fields)) {
                return format!("{indent}{before}uint8_t {name} {listed}");
            }
            let cases = variants.iter().filter(|variant| !is_plain(&variant.fields));
            let cases: String = cases
                .map(|variant| {
                    let members = members(&variant.fields, depth + 2);
                    let name = identifier(&variant.name);
                    format!("{indent}        struct {{\n{members}{indent}        }} {name};\n")
                })
                .collect();
            format!(
                "{indent}{before}struct {{\n{indent}    uint8_t tag; {listed}\n\
                 {indent}    union {{\n{cases}{indent}    }} as;\n{indent}}} {name}"
            )
        }
        // They have no packed form, and no port has them.
        _ => format!("{indent}{before}uint8_t {name}"),
    }
}

fn members(fields: &Fields<LayoutOf>, depth: usize) -> String {
    let mut text = String::new();
    for field in fields.as_slice() {
        let digit = field.name.starts_with(|c: char| c.is_ascii_digit());
        let name = if digit { format!("_{}", field.name) } else { identifier(&field.name) };
        let _ = write!(text, "{};", declared("", field.of, &name, depth + 1));
        let notes: Vec<_> = field.unit.iter().chain(&field.frame).map(|note| &**note).collect();
        match notes.is_empty() {
            true => text.push('\n'),
            false => drop(writeln!(text, " /* {} */", notes.join(", in frame "))),
        }
    }
    text
}

fn leaf_declared(leaf: Primitive, name: &str) -> String {
    match leaf {
        Primitive::Bool | Primitive::U8 | Primitive::Unit | Primitive::Text => {
            format!("uint8_t {name}")
        }
        Primitive::U16 => format!("uint16_t {name}"),
        Primitive::U32 | Primitive::Char => format!("uint32_t {name}"),
        Primitive::U64 => format!("uint64_t {name}"),
        Primitive::I8 => format!("int8_t {name}"),
        Primitive::I16 => format!("int16_t {name}"),
        Primitive::I32 => format!("int32_t {name}"),
        Primitive::I64 => format!("int64_t {name}"),
        Primitive::F32 => format!("float {name}"),
        Primitive::F64 => format!("bl_f64 {name}"),
        Primitive::U128 | Primitive::I128 => format!("struct {{ uint8_t bytes[16]; }} {name}"),
        Primitive::Duration => format!("struct {{ uint64_t s; uint32_t ns; }} {name}"),
        _ => format!("uint8_t {name}"),
    }
}
